"""The online estimator of a joint: rows while they happen, recursion, guard, faults; no FMI in
it.
"""
