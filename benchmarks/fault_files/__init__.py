"""Sensor faults in files without velocities, judged by the fault bank."""
