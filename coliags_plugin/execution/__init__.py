"""Work in worker processes: tasks, where they run, and the queue that retries them."""
