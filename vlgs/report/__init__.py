"""The report of a finished run: scores, speed, pictures, metrics.json and the summary on the terminal."""
