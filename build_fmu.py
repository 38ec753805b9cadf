"""Build the FMUs of a joint: ``python build_fmu.py estimator|plant|native|ssp|all --joint J --out
dist``.

    estimator   online estimator of the joint file's parameters (FMI 2.0 co-simulation)
    plant       the joint itself, open loop (FMI 2.0 model exchange and co-simulation)
    native      the estimator in C, without Python in the host (FMI 2.0 co-simulation)
    ssp         source, plant and estimator as one system (SSP 1.0)
    all         everything above, and the plant with controller and sensors

Options: --cc gcc|zig, --target linux64|win64|darwin64|TRIPLE|all, --controller, --sensors,
--healthy RECORD, --sample-time S (native); see ``--help``. Every FMU is checked by fmpy's
``validate_fmu`` and run in a fresh process before it appears in the folder.
"""

from __future__ import annotations

import sys

from irj_fmu.build import script

if __name__ == "__main__":
    sys.exit(script(sys.argv[1:]))
