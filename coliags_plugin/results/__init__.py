"""Results of evaluated runs: one file per run and protocol, its schema, its key and its exports."""
