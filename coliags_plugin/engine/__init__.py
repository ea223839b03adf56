"""Training, evaluation, checkpoints and reports: where the components meet."""
