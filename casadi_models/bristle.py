"""The bristle of presliding friction: dz/ds = 1 - z sign(ds), with s the way over its distance."""

from __future__ import annotations

import casadi as ca

from casadi_models.signals import Expression


def after(z: Expression, way: Expression) -> Expression:
    """Its state after a step of the way, exact where the coordinate does not turn within it.

    Parameters
    ----------
    z : expression
        From -1 to 1.
    way : expression
        Signed, over the presliding distance.
    """
    end = ca.sign(way)
    return end + (z - end) * ca.exp(-ca.fabs(way))


def rate(z: Expression, pace: Expression) -> Expression:
    """dz/dt at a velocity over the presliding distance [1/s]."""
    return pace - ca.fabs(pace) * z
