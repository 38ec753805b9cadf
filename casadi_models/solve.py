"""Accelerations and carried torque where the laws refer to them: affine, or by a few Newton
steps; one step in time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import casadi as ca

from .equations import Equations
from .signals import Expression

NEWTON_STEPS: Final = 8
"""Steps of the unrolled Newton iteration; it converges quadratically and is exact after one
where the law is affine.
"""


def runge_kutta(slope: Callable[[float, Any], Any], x: Any, h: Any) -> Any:
    """State after one Runge-Kutta step of 4th order (W. Kutta 1901), symbols or numbers alike.

    Parameters
    ----------
    slope : callable
        ``slope(share, x)``: rates of the state x at that share (0, 0.5, 1) of the step.
    x : expression or array
        State at the begin.
    h : expression or float
        Step [s].
    """
    k1 = slope(0.0, x)
    k2 = slope(0.5, x + h / 2 * k1)
    k3 = slope(0.5, x + h / 2 * k2)
    k4 = slope(1.0, x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def affine_solution(right: Expression, acceleration: Expression, inertia: Expression) -> Expression:
    """Acceleration from inertia * a = right(a), where right is affine in a."""
    slope = ca.jacobian(right, acceleration)
    (free,) = ca.substitute([right], [acceleration], [ca.SX(0)])
    return free / (inertia - slope)


def carried_torque(e: Equations, carried: Expression | None = None) -> Expression:
    """Torque into the link in terms of positions, velocities, memory and parameters.

    Where the law of the carried torque refers to the torque itself (compliance of the torque sensor
    in series, load-dependent friction on the link), T = f(T) is solved by Newton steps from T = 0.
    Where it refers to the rate of the torque, that is :func:`carried_rate`.

    Parameters
    ----------
    e : Equations
    carried : expression, optional
        f(T); what the transmission carries by default.
    """
    law = e.transmitted if carried is None else carried
    (law,) = ca.substitute([law], [e.signals.torque_rate], [carried_rate(e, law)])
    return _solved(law, e.signals.torque)


def carried_rate(e: Equations, carried: Expression | None = None) -> Expression:
    """Rate of the carried torque where its law refers to it (a damping beside the compliance of the
    torque sensor), else zero; arguments as in :func:`carried_torque`.

    It is that of the torque without this term, along the motion: damping times compliance is a lag
    of less than a millisecond, and this is its first order.
    """
    law, s = e.transmitted if carried is None else carried, e.signals
    if not ca.depends_on(law, s.torque_rate):
        return ca.SX(0)
    (slow,) = ca.substitute([law], [s.torque_rate], [ca.SX(0)])
    places = ca.vertcat(s.motor_position, s.link_position)
    moving = ca.vertcat(s.motor_velocity, s.link_velocity)
    return ca.jtimes(_solved(slow, s.torque), places, moving)


def _solved(law: Expression, torque: Expression) -> Expression:
    """T from T = law(T)."""
    if not ca.depends_on(law, torque):
        return law
    slope = ca.jacobian(law, torque)
    newton = (law - slope * torque) / (1 - slope)
    found: Expression = ca.SX(0)
    for _ in range(NEWTON_STEPS if ca.depends_on(slope, torque) else 1):
        (found,) = ca.substitute([newton], [torque], [found])
    return found


def rigid_solution(
    right: Expression,
    carried: Expression,
    inertia: Expression,
    acceleration: Expression,
    torque: Expression,
) -> tuple[Expression, Expression]:
    """Acceleration a and torque into the link T of a rigid joint.

    Solves inertia * a = right(a, T) and T = carried(a, T) together.

    Parameters
    ----------
    right, carried, inertia : expression
    acceleration, torque : symbol
        a and T as they stand in `right` and `carried`.
    """
    unknown = ca.vertcat(acceleration, torque)
    defect = ca.vertcat(inertia * acceleration - right, torque - carried)
    m = ca.jacobian(defect, unknown)
    determinant = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    newton = unknown - ca.vertcat(
        (m[1, 1] * defect[0] - m[0, 1] * defect[1]) / determinant,
        (m[0, 0] * defect[1] - m[1, 0] * defect[0]) / determinant,
    )
    found = ca.SX.zeros(2, 1)
    for _ in range(NEWTON_STEPS if ca.depends_on(m, unknown) else 1):
        (found,) = ca.substitute([newton], [unknown], [found])
    return found[0], found[1]
