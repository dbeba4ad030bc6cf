"""What several areas need: a small procedural scene, read once, and the folder of real data."""

import contextlib
import dataclasses
import functools
import gc
import importlib
import os
import pickle
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import jaxtyping
import pytest

if TYPE_CHECKING:
    from vlgs.types import Scene

# Two workers with two threads each on two cores: a thread that waits must not keep the core of one that works. Read when torch is loaded,
# here and in every process that a test starts.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def pytest_configure(config: pytest.Config) -> None:
    """Import what most tests need, in each process that runs tests; pytest's own, which hands them out, needs none of it."""
    if config.getoption("dist", "no") != "no" and "PYTEST_XDIST_WORKER" not in os.environ:
        return
    # A third of the time until the first test would go into looking for garbage among modules, which are none.
    gc.disable()
    # While a module of vlgs is imported, jaxtyping looks for compiled files under names of its own, also for all that this module
    # imports: without this, 3 500 modules of other packages would be compiled anew in every worker.
    for name in ("torch", "torchmetrics", "lightning.pytorch.loggers", "kornia", "matplotlib.pyplot", "pandas", "viser"):  # fmt: skip
        try:
            importlib.import_module(name)
        except ImportError:  # an extra that is not installed
            continue


def pytest_collection_finish() -> None:
    """From here on garbage is looked for among what tests make, not among all that was imported for them."""
    gc.freeze()
    gc.enable()


@contextlib.contextmanager
def checks_of_types(on: bool) -> Iterator[None]:
    """Whether values are held against the types and shapes of signatures."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", not on)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", before)


@pytest.fixture(scope="session", autouse=True)
def files_of_options_parsed_once() -> Iterator[None]:
    """Hydra composes hundreds of configurations of the same files; what it is given of each is made anew."""
    from omegaconf import DictConfig, OmegaConf

    load, kept = OmegaConf.load, dict[str, bytes]()

    def load_once(file: str | Path | IO[str]) -> Any:
        if isinstance(file, str | Path):
            return load(file)
        text = file.read()
        if text in kept:
            return pickle.loads(kept[text])  # a ninth of the time of `OmegaConf.create`
        file.seek(0)
        made = load(file)
        if isinstance(made, DictConfig):
            kept[text] = pickle.dumps(made)
        return made

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OmegaConf, "load", staticmethod(load_once))
        yield


@pytest.fixture(scope="session", autouse=True)
def configurations_copied_at_once() -> Iterator[None]:
    """Hydra copies a configuration for everything that it makes of one, node by node; pickle takes a third of that."""
    from omegaconf import DictConfig

    node_by_node = DictConfig.__deepcopy__

    def at_once(self: Any, memo: dict[int, Any]) -> Any:
        inside, parent = self.__dict__, self.__dict__["_parent"]
        inside["_parent"] = None  # it is kept and not copied
        try:
            text = pickle.dumps(self, pickle.HIGHEST_PROTOCOL)
        except (pickle.PicklingError, AttributeError, TypeError):  # it holds what cannot be pickled
            text = b""
        finally:
            inside["_parent"] = parent
        if not text:
            return node_by_node(self, memo)
        copied = pickle.loads(text)
        copied.__dict__["_parent"] = parent
        return copied

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DictConfig, "__deepcopy__", at_once)
        yield


@pytest.fixture(scope="session", autouse=True)
def interpolations_parsed_once() -> Iterator[None]:
    """Every configuration has the same few dozen of them; the tree of a text is only read."""
    from omegaconf import grammar_parser

    parse = functools.lru_cache(maxsize=4096)(grammar_parser.parse)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("omegaconf.base.parse", parse)
        patch.setattr("omegaconf._utils.parse", parse)
        yield


@pytest.fixture(scope="session", autouse=True)
def groups_of_options_joined_once() -> Iterator[None]:
    """Nine tenths of the time that Hydra takes for a configuration go into finding and joining the files of its groups, mostly the same ones."""
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from hydra._internal.defaults_list import _create_interpolation_map, create_defaults_list

    from vlgs.config import CONF

    def map_where_asked(overrides: Any, defaults: list[Any], self_added: bool) -> Any:
        """Hydra makes one for every file; of our defaults none has an interpolation."""
        asked = any("${" in repr(one) for one in defaults)
        return _create_interpolation_map(overrides, defaults, self_added) if asked else None

    join = ConfigLoaderImpl._compose_config_from_defaults_list
    found, kept = dict[Any, Any](), dict[str, bytes]()

    def of_ours_alone(repo: Any) -> bool:
        folders = {
            Path(source.path) for source in repo.get_sources() if Path(source.path).is_absolute()
        }
        return folders == {CONF}  # else a test's own files, which it may write anew

    def find_once(repo: Any, config_name: Any, overrides_list: Any, **how: Any) -> Any:
        if not of_ours_alone(repo) or any(one.is_sweep_override() for one in overrides_list):
            return create_defaults_list(repo, config_name, overrides_list, **how)
        values = [
            one
            for one in overrides_list
            if not repo.group_exists(one.key_or_group) or isinstance(one.value(), dict)
        ]
        groups = tuple(one.input_line for one in overrides_list if one not in values)
        key = (config_name, groups, *sorted(how.items()))
        if key not in found:
            found[key] = create_defaults_list(repo, config_name, overrides_list, **how)
        return dataclasses.replace(found[key], config_overrides=values)

    def join_once(self: ConfigLoaderImpl, defaults: Any, repo: Any) -> Any:
        if not of_ours_alone(repo):
            return join(self, defaults, repo)
        key = repr(defaults)
        if key not in kept:
            kept[key] = pickle.dumps(join(self, defaults, repo))
        return pickle.loads(kept[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hydra._internal.defaults_list._create_interpolation_map", map_where_asked)
        patch.setattr("hydra._internal.config_loader_impl.create_defaults_list", find_once)
        patch.setattr(ConfigLoaderImpl, "_compose_config_from_defaults_list", join_once)
        yield


@pytest.fixture(scope="session", autouse=True)
def rows_of_tables_composed_once() -> Iterator[None]:
    """The tests ask for a few dozen rows hundreds of times, and Hydra takes a tenth of a second for each."""
    from vlgs.tables import benchmark

    compose = benchmark._compose
    known = functools.cache(lambda overrides: compose(list(overrides)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(benchmark, "_compose", lambda overrides: known(tuple(overrides)))
        yield


@pytest.fixture(scope="session", autouse=True)
def traced_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Runs have a results folder each, and in it a cache of photographs; what one test has traced is laid into the next one's cache."""
    from vlgs.data.synthetic import capture

    base = tmp_path_factory.getbasetemp()
    common = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    original, taken = capture._photographs, capture._taken

    def taken_unchecked(world: Any, cameras: Any, settings: Any) -> Any:
        """A third of the time would be checks of types; tests of the tracer itself call it directly."""
        with checks_of_types(False):
            return taken(world, cameras, settings)

    def photographs(world: Any, cameras: Any, settings: Any, cache: Path | None) -> Any:
        if cache is None:
            return original(world, cameras, settings, None)
        name = f"capture-{settings.fingerprint(level=0)}.npz"
        kept = common / name
        if kept.is_file() and not (cache / name).exists():
            cache.mkdir(parents=True, exist_ok=True)
            shutil.copy(kept, cache)
        photos = original(world, cameras, settings, cache)
        if not kept.is_file():
            shutil.copy(cache / name, base)
            (base / name).replace(kept)
        return photos

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(capture, "_photographs", photographs)
        patch.setattr(capture, "_taken", taken_unchecked)
        yield


@pytest.fixture(scope="module", autouse=True)
def codes_fitted_once(request: pytest.FixtureRequest) -> Iterator[None]:
    """Hundreds of runs of the same few scenes fit the same autoencoder, for half a second each; where it is tested itself it is fitted."""
    from vlgs.heads.autoencoder import Autoencoder

    if request.path.parent.name == "heads":
        yield
        return
    fit = Autoencoder._fit

    def fit_once(self: Autoencoder, vectors: Any, areas: Any) -> None:
        layout = (self.dim, self.encoder_widths, self.decoder_widths, self.center, vectors.shape)
        key = (layout, repr(self.fit_settings), vectors.numpy().tobytes(), areas.numpy().tobytes())
        if key in FITTED:
            self.build(vectors.shape[1])
            self.load_state_dict(pickle.loads(FITTED[key]))
        else:
            fit(self, vectors, areas)
            FITTED[key] = pickle.dumps(self.state_dict())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Autoencoder, "_fit", fit_once)
        yield


FITTED = dict[Any, bytes]()
"""Autoencoder and what it was fitted to -> its weights."""


@pytest.fixture(scope="session", autouse=True)
def frame_rates_of_few_views() -> Iterator[None]:
    """A run takes up to five seconds to measure its frame rates, which no test compares."""
    from vlgs import finish

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finish, "measure_fps", functools.partial(finish.measure_fps, seconds=0.0))
        yield


WHOLE_RUNS = frozenset(
    {"bench", "export", "fuzz", "gallery", "opened", "query", "render", "run", "stress", "view"}
)


@pytest.fixture(scope="module", autouse=True)
def types_are_checked_in_parts(request: pytest.FixtureRequest) -> Iterator[None]:
    """Checks of types and shapes take two fifths of a training run: where whole runs are tested they are off, tests of their parts have them."""
    with checks_of_types(request.path.parent.name not in WHOLE_RUNS):
        yield


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Likewise for a test that trains or traces the same several times, what its neighbours do once with checks."""
    with checks_of_types(False):
        yield


@pytest.fixture(scope="session")
def tiny_scene() -> "Scene":
    from vlgs.data.synthetic import load_scene

    return load_scene(width=48, height=36, train_views=6, test_views=2, points=400)


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """SAM and CLIP of a few thousand random weights."""
    from tiny_models import save_models

    return save_models(tmp_path_factory.mktemp("weights"))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real data beside the checkout; tests that need it skip without it."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("needs the real data beside the checkout")
    return folder
