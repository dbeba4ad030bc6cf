"""The YAML options mirror their constructors."""

from pathlib import Path

import hydra
import pytest
from omegaconf import OmegaConf

from vlgs.queries import LerfRelevancy, VocabSoftmax
from vlgs.queries.text import ClipText, VocabularyText

CONF = Path(__file__).parents[2] / "conf"


@pytest.mark.parametrize(
    ("option", "want"),
    [
        ("query/lerf_relevancy", LerfRelevancy()),
        ("query/vocab_softmax", VocabSoftmax()),
    ],
)
def test_option_equals_the_default(option: str, want: object):
    assert hydra.utils.instantiate(OmegaConf.load(CONF / f"{option}.yaml")) == want


@pytest.mark.parametrize(("option", "kind"), [("vocabulary", VocabularyText), ("clip", ClipText)])
def test_text_options_wait_for_the_scene(option: str, kind: type):
    waiting = hydra.utils.instantiate(OmegaConf.load(CONF / "text" / f"{option}.yaml"))
    assert isinstance(waiting(vocabulary=None), kind)
