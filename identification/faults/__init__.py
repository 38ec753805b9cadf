"""Sensor faults: injected, found, isolated, replaced (thesis 4.2, 4.4)."""
