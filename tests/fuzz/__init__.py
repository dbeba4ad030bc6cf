"""Attacks on what the project reads, writes and is told: `python -m tests.fuzz` makes the table "tried, right".

Each module of this folder but `judge` and `commands` is one family and offers ``attacks(folder, seed, count)``: an iterator of `judge.Attack`, where
`folder` is an empty scratch folder. An attack is a function of (family, seed, number), so that a failure is run again with
``python -m tests.fuzz FAMILY --seed SEED --only NUMBER``.
"""
