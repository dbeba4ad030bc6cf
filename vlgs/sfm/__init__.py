"""Cameras from photographs alone, through COLMAP: `python -m vlgs.sfm IMAGES OUT`."""
