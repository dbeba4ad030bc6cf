"""Run time against error; `python -m vlgs.bench kernel` times the rasterizer."""
