"""Values of a joint that no fit has seen: those of the joint file, else the typical ones of the
declarations.
"""

from __future__ import annotations

from casadi_models import JointModel
from identification.data.joint_file import Joint


def true_values(model: JointModel, joint: Joint) -> dict[str, float]:
    """Parameter values: those of the joint file, else the typical ones of the declarations."""
    known = {n: k.value for n, k in joint.known.items() if k.value is not None}
    return {
        n: float(known[n]) if n in known and n not in model.values else v
        for n, v in model.usual_values().items()
    }
