"""From the metrics files of runs to the tables of the paper. Imports no torch."""
