"""A run folder, opened: the trained scene and what was known of it, without the data that it learned from.

`vlgs.query`, `vlgs.render`, `vlgs.view` and `vlgs.export` begin with `open_run`.
"""

from vlgs.opened.run import NamedCamera, OpenedRun, open_run

__all__ = ["NamedCamera", "OpenedRun", "open_run"]
