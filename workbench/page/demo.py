"""The demo of the page: the records and the joint file that `irj demo` uses, a joint whose
model lacks one effect.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from typing import Final

FILES: Final = ("joint.toml", "train.npz", "held_out.npz")


@lru_cache(maxsize=1)
def demo_files() -> dict[str, bytes]:
    """Joint file, a record for the fit and one held out, by file name."""
    folder = files("workbench") / "demo"
    return {name: (folder / name).read_bytes() for name in FILES}
