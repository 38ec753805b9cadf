"""Which lines of the workbench the tests run, in every process that they start."""
