"""Every ablation table from one command: which runs a table needs, and running those that are missing."""
