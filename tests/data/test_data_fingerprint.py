"""What is read of a scene and moves a result stands in its fingerprint."""

import json
from pathlib import Path

from colmap_scenes import add_dense, write_scene

from vlgs.data.colmap import load_scene


def test_kinds_of_classes_count(tmp_path: Path):
    """Scores of translucent and reflective classes depend on them; a finished run would be taken for this one."""
    add_dense(tmp_path, write_scene(tmp_path))
    before = load_scene(str(tmp_path))
    path = tmp_path / "labels" / "classes.json"
    content = json.loads(path.read_text())
    content["classes"]["3"]["kind"] = "other"
    path.write_text(json.dumps(content))
    after = load_scene(str(tmp_path))
    assert (before.class_kinds["glass"], after.class_kinds["glass"]) == ("translucent_reflective", "other")  # fmt: skip
    assert before.fingerprint != after.fingerprint
