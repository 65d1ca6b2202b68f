"""The explicit matrix of a phase, against products with it."""

from dataclasses import replace

import numpy as np
import pytest

from zwfs import Pupil
from zwfs.frames._explicit import Explicit, Posterior
from zwfs.frames._light import Light
from zwfs.frames._optics import Camera, Exposure
from zwfs.frames._segments import Segments, nearest_parts
from zwfs.frames._solver import MapPrior, PhaseMap, Point, Problem

N, F, SHAPE = 24, 2, (30, 30)
VALUES = np.array(
    [
        *(3e-4, 0.3, -0.4, 0.8, 1.02, 1e4, 2),
        *(-2e-4, -0.2, 0.6, 0.02, 1.01, 1e4, 1),
        *(1.1, 1.5, -1.4, 0.05, 0.03, 0.7),
    ]
)


QUARTERS = np.pad(Pupil.circular(16).amplitude > 0, 4) * (
    1 + np.add.outer(np.arange(N) > 11, 2 * (np.arange(N) > 11))
)


@pytest.fixture(scope="module", params=[0.0, 0.5], ids=["smooth", "with jumps"])
def guided(request):
    light = np.pad(Pupil.circular(16 * F).amplitude, 4 * F)
    exposures = [Exposure(0, 0, 0), Exposure(1, 1, 0)]
    camera = Camera(N, SHAPE, 16, exposures, np.zeros((1, N * F, N * F)), F, 1.5)
    segments = Segments(QUARTERS, nearest_parts(QUARTERS, F)) if request.param else None
    phase_map = PhaseMap(N, F, MapPrior(0.5, 4.0, jumps=request.param), 16, segments)
    lit = Light(light, np.ones_like(light), light > 0, light > 0)
    images = np.full((2, *SHAPE), 1e4), np.full((2, *SHAPE), 1e-2)
    problem = Problem(camera, *images, lit, phase_map, (), VALUES)
    white = 0.5 * np.random.default_rng(0).normal(size=phase_map.n_white)
    data = Explicit.of(Point(problem, white))
    return Point(replace(problem, guide=Posterior(data, phase_map)), white)


def test_inverse_of_the_explicit_matrix_is_that_of_the_products(guided):
    true = np.random.default_rng(1).normal(size=guided.x.shape)
    guide, means = guided.problem.guide, guided.problem.phase_map.means
    left = guide.inverse(guided.matrix.product(true)) - true
    error, phase = (means(white)[7:-7, 7:-7] for white in (left, true))
    assert error.std() < (0.08 if guided.problem.phase_map.stepped else 0.05) * phase.std()


def test_sums_of_the_evidence_are_those_of_the_eigenvalues(guided):
    matrix = guided.matrix.product(np.eye(len(guided.x)))
    values = np.linalg.eigvalsh((matrix + matrix.T) / 2)
    guide = guided.problem.guide
    assert guide.determined == pytest.approx(np.sum(1 - 1 / values), rel=0.1)
    assert guide.log_determinant == pytest.approx(np.sum(np.log(values)), rel=0.05)


def test_evidence_in_closed_form_is_that_of_a_step_to_the_best_phase(guided):
    """Between two strengths of the prior; what they share does not count."""
    noise = np.random.default_rng(2).normal(size=(2, *SHAPE)) / guided.problem.weights
    guided = Point(replace(guided.problem, counts=guided.model.images + noise), guided.x)
    data, means = guided.problem.guide._data, guided.phase_means
    steps = guided.problem.phase_map.steps(guided.x)
    closed, stepped = [], []
    for rms in (0.5, 1.5):
        of = guided.problem.phase_map
        phase_map = PhaseMap(N, F, of.prior._replace(rms=rms), 16, of.segments)
        guide = Posterior(data, phase_map)
        closed.append(guide.evidence(data.best(guided))[0])
        point = Point(replace(guided.problem, phase_map=phase_map, guide=guide), phase_map.white(means, steps))
        matrix = point.matrix.product(np.eye(len(point.x)))
        matrix = (matrix + matrix.T) / 2
        cost = point.cost - point.gradient @ np.linalg.solve(matrix, point.gradient) / 2
        stepped.append(cost + np.linalg.slogdet(matrix)[1] / 2)
    assert np.diff(closed) == pytest.approx(np.diff(stepped), abs=0.05 * guide.log_determinant)


def test_images_without_a_good_pixel_leave_the_prior(guided):
    problem = replace(guided.problem, weights=np.zeros((2, *SHAPE)))
    posterior = Posterior(Explicit.of(Point(problem, guided.x)), problem.phase_map)
    np.testing.assert_allclose(posterior.inverse(guided.x), guided.x, rtol=0, atol=1e-6)
    assert posterior.determined < 1e-6


def test_steps_of_segments_are_found_in_their_phase():
    segments, rng = Segments(QUARTERS, nearest_parts(QUARTERS, F)), np.random.default_rng(0)
    steps, fine = rng.normal(size=12), rng.normal(size=(3, N * F, N * F))
    np.testing.assert_allclose(segments.fitted(segments.means(steps)), steps, rtol=0, atol=1e-12)
    np.testing.assert_allclose(segments.adjoint(fine) @ steps, np.sum(fine * segments.fine(steps), axis=(1, 2)))
    lit = np.kron(QUARTERS == 2, np.ones((F, F))) > 0
    np.testing.assert_allclose(segments.fine(np.eye(12))[3:6, lit].std(axis=1), [0, 1, 1], atol=1e-12)


def test_large_pupil_has_no_explicit_matrix(guided, monkeypatch):
    monkeypatch.setattr("zwfs.frames._explicit._MOST", 100)
    assert Explicit.of(guided) is None
    assert not Explicit.suits(guided.light, F)
