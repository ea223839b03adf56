"""The contract of a method, as a list of checks on a small scene: the tests' and ``coliags check``'s."""
