"""Errors of the phase-shifted iteration on many screens, on a Dask cluster."""

import joblib
import numpy as np
from dask.distributed import Client, LocalCluster

import zwfs
from zwfs.experiments import linearity_curves


def main():
    """Run the sweep on a cluster of two processes, and print how many screens were recovered."""
    pupil = zwfs.Pupil.circular(64)
    modes = zwfs.zernike_basis(pupil, 100)
    dimples = zwfs.Dimple(1.06, np.pi / 2), zwfs.Dimple(1.06, -np.pi / 2)
    methods = {"PhaseShifted": zwfs.PhaseShifted(zwfs.ZernikeSensor(pupil, *dimples))}
    inputs = np.linspace(0.1, 1.0, 10)
    with LocalCluster(n_workers=2, threads_per_worker=1) as cluster, Client(cluster) as client:
        client.wait_for_workers(2)
        with joblib.parallel_config(backend="dask"):
            curves = linearity_curves(methods, modes, inputs, n_screens=20, seed=1)
    for rms, share in zip(inputs, curves.recovered("PhaseShifted"), strict=True):
        print(f"{rms:.1f} rad rms: {share:.0%} of the screens recovered")


if __name__ == "__main__":
    main()
