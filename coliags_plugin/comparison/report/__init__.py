"""HTML report of evaluated runs: metrics, charts and images."""
