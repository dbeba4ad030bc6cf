"""From files or formulas to a `vlgs.types.Scene`: one module per source, each with a `load_scene`."""
