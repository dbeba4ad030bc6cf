"""Opens a run folder."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from vlgs.config import check_targets, find, instantiate
from vlgs.earlier import as_today
from vlgs.fields import NO_LANGUAGE, Field, faster
from vlgs.fields.saved import MakePart
from vlgs.opened.files import NamedCamera, SceneNotes, field_of, read_field, read_scene
from vlgs.opened.words import Words
from vlgs.places import found_again
from vlgs.queries import Query, Questions
from vlgs.runs import RunFolder
from vlgs.targets import require_importable, require_plugins
from vlgs.training.checkpoint import load_checkpoint

_DAMAGED = (
    *(OmegaConfBaseException, HydraException, YAMLError, UnicodeDecodeError),
    *(AssertionError, AttributeError, KeyError, TypeError, RecursionError),
)
"""What reading a configuration that is none ends in."""

_NEEDED = frozenset({"query", "text"})
"""Keys that every run has recorded, and that answers are made with."""

_FREE = frozenset({"vlgs.fusion.none.NoFusion", "vlgs.indicator.Learned"})
"""What a model may have in place of what the configuration chooses: nothing that needs an argument."""


@dataclass(frozen=True)
class OpenedRun:
    """A trained scene that can be asked, drawn and shown."""

    path: Path
    """The run folder."""
    field: Field
    notes: SceneNotes
    query: Query
    """How relevancy is computed."""
    words: Words
    """What gives words their vectors."""
    step: int | None
    """How far a run is that still trains; None: it is finished."""

    def cameras(self, split: str | None = None) -> Sequence[NamedCamera]:
        """Where photographs were taken: of one split, ``train`` or ``test``, or all."""
        return [one for one in self.notes.cameras if split in (None, one.split)]

    @property
    def levels(self) -> tuple[int, ...]:
        """Mask levels that can be asked for, as the data number them, in the order of the field; none where it answers for all at once."""
        known = tuple(level for level in self.notes.levels if level is not None)
        return known if len(known) == len(self.field.levels()) else ()

    def held_out(self) -> Sequence[NamedCamera]:
        """Cameras of held-out photographs; where there are none, all."""
        return self.cameras("test") or self.cameras()

    def place(self, level: int) -> int:
        """Place of a mask level among those of the field.

        Raises:
            ValueError: If it cannot be asked for.
        """
        if level not in self.levels:
            known = ", ".join(map(str, self.levels)) or "none, as it answers for all at once"
            raise ValueError(f"{self.path}: level must be one of the run's, {known}, got {level}")
        return self.levels.index(level)

    def ask(self, words: Sequence[str]) -> Questions:
        """Words together with all that a query needs for them.

        A run whose vocabulary lacks the words that its query compares with has its words compete with each other: the note says so.

        Raises:
            ValueError: If there is no word, one cannot be encoded, or the run knows no language.
            OSError: If weights are missing.
        """
        if not self.field.has_language:
            raise ValueError(f"{self.path}: cannot be asked for words, {NO_LANGUAGE}")
        return self.words.ask(self.query, words)


def open_run(
    folder: Path | str,
    vocabulary: Path | None = None,
    text: str | None = None,
    template: str = "{}",
    within: float | None = None,
    plugins: Sequence[str] = (),
) -> OpenedRun:
    """Open the folder of a run, finished or still training.

    Args:
        folder: ``<results>/runs/<run id>``.
        vocabulary: A file of further words and vectors (`vlgs.vocabulary` makes one).
        text: Name or folder of a CLIP or SigLIP whose text tower encodes what no vocabulary has; None: that of the run, if it had one.
        template: Sentence around words that a text tower encodes.
        within: By how much cosines may be off, to save time (`vlgs.fields.faster`); None: as scores are made.
        plugins: Packages whose parts may be made where the run has them; what its files say by themselves is trusted by nobody.

    Raises:
        ValueError: If a plugin is not there, or it is no run folder, has nothing to show yet, or is of another version.
        OSError: If a file cannot be read.
    """
    path = Path(folder)
    run = RunFolder(path)
    if not run.config.is_file():
        raise ValueError(f"{path}: must be the folder of a run, with config.yaml in it, got none")
    config = read_config(path, plugins)
    query = _query(run, config)
    notes = read_scene(run)
    field, step = _field(run, partial(_make, config))
    field = field if within is None else faster(field, within)
    known = Words.of(notes.vocabulary, config.text, vocabulary, text, template)
    return OpenedRun(path, field, notes, query, known, step)


def read_config(path: Path, plugins: Sequence[str] = ()) -> DictConfig:
    """The configuration of a run folder in today's words. It names no class but ours and those of the plugins.

    Raises:
        ValueError: If it is not that of a run, or a plugin is not there; the file is named.
    """
    require_importable(require_plugins(plugins))
    file = RunFolder(path).config
    try:
        recorded = found_again(path.resolve())
        missing = sorted(_NEEDED - {key for key, value in recorded.items() if value is not None})
        config = as_today(recorded)
        # A file's word is nobody's trust.
        check_targets(config, plugins=plugins, trust="--plugins {}")
    except _DAMAGED as error:
        reason = str(error).partition("\n")[0] or "a list"
        raise ValueError(f"{file}: must be that of a run, got: {reason:.200}") from error
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error
    if missing:  # the defaults would answer in its name
        raise ValueError(f"{file}: must be that of a run, got none of {', '.join(missing)}")
    return config


def _query(run: RunFolder, config: DictConfig) -> Query:
    """How relevancy is computed.

    Raises:
        ValueError: If the configuration has a value that cannot be; the file is named.
    """
    try:
        return instantiate(config.query)
    except ValueError as error:
        raise ValueError(f"{run.config}: {error}") from error


def _field(run: RunFolder, make: MakePart) -> tuple[Field, int | None]:
    """The field that was kept in the end; before that the one of the newest checkpoint that describes one."""
    if run.field.is_file():
        return read_field(run, make), None
    found = sorted(run.path.rglob("step_*.safetensors"), key=lambda file: file.stat().st_mtime_ns)
    for folder in dict.fromkeys(file.parent for file in reversed(found)):
        checkpoint = load_checkpoint(folder)
        if checkpoint is not None and "plan" in checkpoint.meta:
            return field_of(checkpoint, make, "model."), checkpoint.step
    raise ValueError(
        f"{run.path}: must have a trained scene ({run.field.name}) or a checkpoint of Gaussians, got neither; the run's command goes on with it"
    )


def _make(config: DictConfig, group: str, path: str) -> Any:
    """A part of a model: that of the configuration, or one that needs no configuration.

    Raises:
        ValueError: If a file asks for something else.
    """
    node = config.get(group)
    if node is not None and _home(str(node._target_)) == path:
        return instantiate(node)
    if path not in _FREE:
        raise ValueError(f"{group} must be that of config.yaml, got {path!r:.80}")
    return instantiate(OmegaConf.create({"_target_": path}))


def _home(target: str) -> str:
    """Where a class is defined."""
    made = find(target)
    return f"{made.__module__}.{made.__qualname__}"
