"""Studies: many runs over models, records and parameters on processes or a Dask cluster."""

from irj_fmu.batch.run import run_study

__all__ = ["run_study"]
