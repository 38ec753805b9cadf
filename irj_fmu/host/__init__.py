"""Hosts: FMUs opened, connected, disturbed and run from Python."""
