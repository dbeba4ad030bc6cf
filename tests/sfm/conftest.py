"""The small COLMAP scenes of the data tests serve here too."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "data"))
