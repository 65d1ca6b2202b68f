"""zwfs beside HCIPy on the pupil of the paper, timed in turns in one run: python -m tests.benchmarks.ratios."""

from time import perf_counter

import numpy as np

from zwfs import Dimple, PhaseShifted, Pupil, ZernikeSensor, power_law_screens, reconstruction_error, zernike_basis

from ..reference import HcipySensor, exact_reference

N_ITERATIONS = 25
DIMPLES = (Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2))


class Contest:
    """The same tasks done by both packages; each task gives what it computed."""

    def __init__(self):
        self.pupil = Pupil.circular(100)
        self.modes = zernike_basis(self.pupil, 200)
        self.phase = power_law_screens(self.modes, 0.8, 1, seed=1)[0]
        self.field = self.pupil.amplitude * np.exp(1j * self.phase)
        self.exact = self.field + exact_reference(self.pupil, DIMPLES[0], self.field)
        self.classic = ZernikeSensor(self.pupil, DIMPLES[0])
        self.shifted = ZernikeSensor(self.pupil, *DIMPLES)
        self.frames = self.shifted.measure(self.phase)
        reconstruct = PhaseShifted(self.shifted, n_iterations=N_ITERATIONS, tolerance=0)
        one, two = HcipySensor(self.pupil, DIMPLES[0]), HcipySensor(self.pupil, *DIMPLES)
        wavefront = one.wavefront(self.field)
        their_frames = two.measure(self.phase)
        self.tasks = {
            "propagation": {
                "zwfs": lambda: self.classic.propagate(self.field)[0],
                "hcipy": lambda: one.optics[0].forward(wavefront).electric_field.reshape(self.pupil.shape),
            },
            # Each from the frames of its own model, so that errors show the algorithm and not the sampling.
            f"{N_ITERATIONS} phase-shifted iterations": {
                "zwfs": lambda: reconstruct(self.frames).phase,
                "hcipy": lambda: two.phase_shifted(their_frames, N_ITERATIONS),
            },
        }

    def error(self, task, result):
        """Largest error of a field, from the exact kernel, or rms error of a phase, in radian."""
        if task == "propagation":
            return float(np.abs(result - self.exact)[self.pupil.mask].max())
        return float(reconstruction_error(self.pupil, result, self.phase))


def best_in_turns(functions, seconds=6.0, turn=0.02):
    """Shortest time of each function; they take short turns, so that a busy machine slows all of them."""
    best = dict.fromkeys(functions, np.inf)
    for function in functions.values():
        function()  # transforms are planned, and precisions converted, at the first call
    end = perf_counter() + seconds
    while perf_counter() < end:
        for name, function in functions.items():
            begin = start = perf_counter()
            while start - begin < turn:
                function()
                begin_of_call, start = start, perf_counter()
                best[name] = min(best[name], start - begin_of_call)
    return best


def main():
    contest = Contest()
    print(f"{'':30}{'zwfs':>12}{'HCIPy':>12}{'ratio':>8}{'error zwfs':>12}{'error HCIPy':>13}{'ratio':>10}")
    for task, functions in contest.tasks.items():
        times = best_in_turns(functions)
        errors = {name: contest.error(task, function()) for name, function in functions.items()}
        print(
            f"{task:30}{times['zwfs'] * 1e3:9.3f} ms{times['hcipy'] * 1e3:9.3f} ms"
            f"{times['hcipy'] / times['zwfs']:8.1f}{errors['zwfs']:12.2g}{errors['hcipy']:13.2g}"
            f"{errors['hcipy'] / errors['zwfs']:10.2g}"
        )


if __name__ == "__main__":
    main()
