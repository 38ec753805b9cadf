"""First steps in the terminal: examples, completion, the import of a file."""
