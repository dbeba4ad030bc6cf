"""Pictures of a benchmark: what every row of a table shows of the same views, and where it answers the same word."""
