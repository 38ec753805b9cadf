"""The child in which a user's effect file is tried."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from casadi_models.child.process import Answer, answer, limited
from casadi_models.child.trial import EffectFileError, ends_it
from casadi_models.effect import EFFECTS


def serve() -> None:
    """Try files until standard input ends."""
    answer(_tried)


def _tried(task: dict[str, Any]) -> Answer:
    try:
        with limited(task["memory"], task["seconds"]):
            for path, code in (*task["before"], (task["path"], task["code"])):
                EFFECTS.load_code(Path(path), code.encode("latin-1"), tried=True)
    except MemoryError:
        why = f"it takes more than {task['memory'] / 1e9:.1f} GB of memory"
        return {"refused": str(ends_it(task["path"], why))}, {}
    except EffectFileError as error:
        return {"refused": str(error)}, {}
    except Exception:  # it comes again where the file is run for good, with its kind
        return {"good": False}, {}
    return {"good": True}, {}
