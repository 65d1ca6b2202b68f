"""Support for notebooks: checked parameters, published results, tables, and sweeps over many processes."""

from zwfs.companion import parameters, results, sweeps, tables

__all__ = ["parameters", "results", "sweeps", "tables"]
