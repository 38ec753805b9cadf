"""The command line `irj`: one module a family of verbs."""
