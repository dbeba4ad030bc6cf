"""Code from a configuration: dangerous callables at every place where something is constructed, all refused before any of them runs.

The last attacks are honest command lines, which must pass.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import yaml

from tests.fuzz.commands import command
from tests.fuzz.judge import Attack
from vlgs.command import check_command
from vlgs.known import groups, options

CANARY = "canary"
"""File that is there if code of an attack ran."""

DANGEROUS = (
    *("os.system", "builtins.eval", "builtins.exec", "subprocess.run", "importlib.import_module"),
    *("torch.load", "torch.hub.load", "torch.hub.load_state_dict_from_url", "torch.jit.load"),
    *("torch.utils.cpp_extension.load", "torch.utils.cpp_extension.load_inline", "torch.nn.Linear"),
    *("torch.serialization.os.system", "torch.utils._pytree.importlib.import_module", "torch"),
    *("torch.package.PackageImporter", "torch.multiprocessing.spawn", "torch.compile"),
    *("lightning.fabric.utilities.cloud_io._load", "lightning.pytorch.cli.LightningCLI"),
    *("lightning.pytorch.loggers.logger.os.system", "lightning.pytorch.Trainer", "vlgs"),
    *(
        "vlgs.config.importlib.import_module",
        "vlgs.ablate.job.subprocess.run",
        "vlgs.run.os.system",
    ),
    *("vlgs.fusion.none.__builtins__.eval", "vlgs.fusion.attention.torch.load", "vlgs.run.main"),
    *("vlgs.ops.rasterize._csrc.rasterize", "vlgs.sfm.worker.main", "vlgs.files.os.remove"),
    *("hydra.utils.get_method", "hydra.utils.instantiate", "hydra._internal.utils._locate"),
    *("numpy.load", "numpy.ctypeslib.load_library", "pickle.loads", "yaml.unsafe_load"),
    *("evil_lab.strike", "evil_lab", ".evil_lab.strike", "evil_lab..strike", "evil lab.strike"),
    *("__main__.main", "posix.system", "types.FunctionType", "functools.partial", "site.main"),
)

NO_NAMES = (
    "null",
    "1",
    "1.5",
    "true",
    "[]",
    "[os.system]",
    "'{_target_: os.system}'",
    "''",
    "'???'",
)
"""What is no name at all."""

PLACES = (
    *("data", "data.faults", "gaussians", "gaussians.densify", "sharing", "augment", "fusion"),
    *("indicator", "blend", "head", "head.training", "loss", "raster", "trainer", "trainer.skip"),
    *("trainer.learning_rates", "text", "query", "protocol"),
)
"""Keys that have a part in the default configuration."""

SMUGGLED = (
    ("fusion._target_=evil_lab.strike", "plugins=[os]"),
    ("fusion._target_=os.system", "plugins=[os]"),
    ("fusion._target_=torch.load", "plugins=[torch]"),
    ("fusion._target_=builtins.eval", "plugins=[builtins]"),
    ("fusion._target_=vlgs.run.main", "plugins=[vlgs]"),
    ("plugins=evil_lab",),
    ("plugins=[1]",),
    ("plugins=[evil_lab.os]",),
    ("plugins=['']",),
    ("+fusion._args_=[1]",),
    ("+fusion._partial_=true",),
    ("+fusion._recursive_=true",),
    ("+fusion._convert_=all",),
    ("+fusion.width._target_=os.system",),
    ("+fusion={_target_:os.system}",),
    ("fusion={_target_:os.system}",),
    ("fusion.width={_target_:os.system,command:'touch canary'}",),
    ("fusion.width=[{_target_:os.system}]",),
    ("+data.extra._target_=os.system",),
    ("+data.extra.deep.deeper._target_=os.system",),
    ("data.faults={_target_:os.system}",),
    ("data.faults.noise={_target_:evil_lab.strike}",),
    ("head.encoder_widths=[{_target_:evil_lab.strike}]",),
    ("query.negatives=[{_target_:evil_lab.strike}]",),
    ("logger.loggers=[{_target_:os.system}]",),
    ("logger.loggers=[{_target_:evil_lab.strike}]",),
    ("logger.loggers=[{_target_:lightning.pytorch.Trainer}]",),
    ("logger.loggers={_target_:os.system}",),
    ("logger=tensorboard", "logger.loggers.0._target_=os.system"),
    ("logger=csv", "+logger.extra._target_=os.system"),
    ("augment=offline", "augment.extractor={_target_:evil_lab.strike}"),
    ("augment=offline", "augment.extractor={_target_:vlgs.fusion.none.NoFusion}"),
    ("augment=offline_sam", "augment.extractor._target_=evil_lab.strike"),
    ("augment=offline_sam", "features.extractor.encoder._target_=evil_lab.strike"),
    ("augment=offline_sam", "features.extractor.segmenter.pretrained._target_=torch.load"),
    ("data=colmap", "data.root=.", "data.release={_target_:os.system}"),
    ("data=colmap", "data.root=.", "+data.release.x._target_=evil_lab.strike"),
    ("+evil._target_=os.system",),
    ("++fusion._target_=os.system",),
    ("fusion._target_=${hydra:job.name}",),
    ("fusion._target_=${oc.env:EVIL}",),
    ("data.scene=${oc.decode:'{_target_:os.system}'}", "fusion._target_=${data.scene}"),
    ("+hydra.callbacks.evil._target_=evil_lab.strike",),
    ("hydra.callbacks={evil:{_target_:evil_lab.strike}}",),
    ("hydra.launcher._target_=evil_lab.strike",),
    ("hydra.launcher._target_=os.system",),
    ("hydra.sweeper._target_=evil_lab.strike", "-m"),
    ("hydra.sweeper.params={_target_:evil_lab.strike}", "-m"),
    ("+hydra.launcher.extra._target_=evil_lab.strike", "-m"),
    ("hydra.job_logging.handlers.console.class=evil_lab.strike",),
    ("+hydra.job_logging.handlers.console.()=evil_lab.strike",),
    ("hydra.job_logging={version:1,handlers:{x:{class:evil_lab.strike}},root:{handlers:[x]}}",),
    ("hydra.job_logging.handlers.console.stream=ext://evil_lab.strike",),
    ("hydra.hydra_logging.handlers.console.class=evil_lab.strike",),
    ("hydra.hydra_logging.handlers.console.stream=ext://evil_lab.strike",),
    ("hydra.searchpath=[pkg://evil_lab]",),
    ("hydra.searchpath=[file://.]",),
    ("--config-path=strange",),
    ("--config-name=strange",),
    ("--config-path=strange", "--config-name=evil"),
    ("--experimental-rerun=strange/config.pickle",),
    ("--config-dir=strange/globals", "+data=evil"),
    ("--config-dir=strange/globals", "data=evil"),
    *(
        (f"--config-dir=strange/{kind}", "fusion=evil")
        for kind in ("bomb", "nested", "latin", "list", "words", "pipe")
    ),
    ("--config-dir=strange/logging", "hydra/job_logging=evil"),
    ("--config-dir=strange/plugins", "fusion=evil"),
    ("--config-dir=strange/quiet", "fusion=evil"),
    ("--config-dir=strange/default", "fusion=evil"),
    ("--config-dir=nowhere",),
)
"""Other ways in: words of Hydra's, trees inside values, files of a stranger."""

HONEST = (
    (),
    ("fusion._target_=my_lab.gated.Gated", "plugins=[my_lab]"),
    ("fusion._target_=my_lab.gated.Gated", "+fusion.gates=3", "plugins=[my_lab]"),
    ("fusion=cross", "fusion._target_=vlgs.fusion.attention.SelfAttention"),
    ("--config-dir=strange/honest", "fusion=mine"),
    ("logger=tensorboard", "logger.loggers.0.name=mine"),
    ("logger.loggers=[{_target_:lightning.pytorch.loggers.CSVLogger,save_dir:x}]",),
    ("-m", "fusion=none,mlp", "seed=range(3)"),
    ("augment=offline_sam", "features.weights=x"),
    ("hydra/launcher=processes", "hydra.launcher.n_jobs=2"),
    ("data=lerf_ovs", "data.root=x", "data.scene=ramen"),
    ("data=mipnerf360_goi", "data.root=x", "data.scene=garden", "data.release.labels=y"),
    ("blend.alpha=0.1", "data.scene=mirrors", "trainer.iterations=100", "results=/tmp/a"),
)
NEEDED = ("data.root=x", "data.scene=garden", "data.release.labels=y")


def attacks(folder: Path, seed: int, count: int) -> Iterator[Attack]:
    """A fixed list, whatever the count."""
    write_strangers(folder)
    check_command(())  # what Hydra learns on first use, every child then has
    for number, place in enumerate(PLACES):
        for target in (*DANGEROUS, *NO_NAMES) if place == "fusion" else DANGEROUS[number % 5 :: 5]:
            yield _refused(folder, f"{place}._target_={target}")
    for arguments in SMUGGLED:
        yield _refused(folder, *arguments)
    for group in sorted(groups()):
        for option in options(group) if "/" not in group and group != "features" else ():
            needed = NEEDED if group == "data" else ()
            needed = [n for n in needed if _takes(option, n)]
            yield _accepted(folder, f"{group}={option}", *needed)
    for arguments in HONEST:
        yield _accepted(folder, *arguments)


def write_strangers(folder: Path) -> None:
    """Files of somebody else, a package that leaves a canary when it is imported or called, and an honest one that is only there."""
    (folder / "evil_lab").mkdir(parents=True)
    (folder / "my_lab").mkdir()
    (folder / "my_lab" / "__init__.py").touch()
    strike = f"open({str(folder / CANARY)!r}, 'w').close()\n"
    code = f"{strike}def strike(*a, **k):\n    {strike}"
    (folder / "evil_lab" / "__init__.py").write_text(code)
    evil = {"_target_": "evil_lab.strike"}
    files = {
        "strange/config.yaml": {"plugins": ["evil_lab"], "fusion": evil},
        "strange/evil.yaml": {"hydra": {"callbacks": {"evil": evil}}},
        "strange/globals/data/evil.yaml": {"hydra": {"callbacks": {"evil": evil}}},
        "strange/logging/hydra/job_logging/evil.yaml": {"version": 1},
        "strange/plugins/fusion/evil.yaml": {**evil, "plugins": ["evil_lab"]},
        "strange/quiet/fusion/evil.yaml": evil,
        "strange/default/fusion/evil.yaml": {"defaults": [{"override /hydra/launcher": "joblib"}]},
        "strange/honest/fusion/mine.yaml": {"_target_": "vlgs.fusion.none.NoFusion"},
    }
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(yaml.safe_dump(content))
    path = folder / "strange/globals/data/evil.yaml"
    path.write_text("# @package _global_\n" + path.read_text())
    aliases = (b"%c: &%c [%s]\n" % (c, c, b", ".join([b"*%c" % (c - 1)] * 9)) for c in b"bcdefghij")
    hostile = {
        "bomb": b"_target_: vlgs.fusion.none.NoFusion\na: &a [x]\n" + b"".join(aliases),
        "nested": b"a: " + b"[" * 100_000,
        "latin": b"_target_: \xff\xfe",
        "list": b"- a\n",
        "words": b"a: b: c",
    }
    for name, data in hostile.items():
        path = folder / "strange" / name / "fusion" / "evil.yaml"
        path.parent.mkdir(parents=True)
        path.write_bytes(data)
    (folder / "strange/pipe/fusion").mkdir(parents=True)
    os.mkfifo(folder / "strange/pipe/fusion/evil.yaml")
    (folder / "strange" / "config.pickle").write_bytes(b"cos\nsystem\n(S'touch canary'\ntR.")


def _refused(folder: Path, *arguments: str) -> Attack:
    def call() -> None:
        os.chdir(folder)
        os.environ["EVIL"] = "os.system"
        said = command("run", arguments)
        assert not (folder / CANARY).exists(), "code of the attack ran"
        assert not (folder / "results").exists(), "something was written"
        if said.status:
            raise ValueError(said.error or said.text)

    return Attack(" ".join(arguments), call, must_refuse=True)


def _accepted(folder: Path, *arguments: str) -> Attack:
    def call() -> None:
        os.chdir(folder)
        try:
            check_command(arguments)
        except ValueError as error:
            raise AssertionError(f"refused: {error}") from error

    return Attack(f"honest: {' '.join(arguments)}", call)


def _takes(option: str, needed: str) -> bool:
    key = needed.partition("=")[0]
    if key == "data.root":
        return option not in ("synthetic",)
    if key == "data.scene":
        return option not in ("synthetic", "colmap", "nerfstudio")
    return option in ("mipnerf360_goi", "mipnerf360_gags")
