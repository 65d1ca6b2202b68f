"""A small network of dense layers, trained with NumPy alone."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

STORED = np.float16
"""Type of weights in a file, to which a training rounds them."""
_LEAK = 0.1  # slope of the activation below 0
_RATE = 2e-3  # of Adam at the start; it falls to 0 along a cosine
_BATCH = 250
_MEAN, _SQUARE = 0.9, 0.999  # decay of Adam's averages


class Network(NamedTuple):
    """Layers as plain arrays: outputs = layers(inputs) + inputs @ skip, with inputs scaled to unit variance."""

    center: NDArray[np.float32]  # (n_inputs,)
    scale: NDArray[np.float32]  # (n_inputs,)
    weights: tuple[NDArray[np.float32], ...]  # each (n_from, n_to)
    biases: tuple[NDArray[np.float32], ...]  # each (n_to,)
    skip: NDArray[np.float32]  # (n_inputs, n_outputs)

    def scaled(self, inputs: NDArray) -> NDArray:
        """Inputs (k, n_inputs) with zero mean and unit variance over those of the training."""
        return (inputs - self.center) * self.scale

    def __call__(self, scaled: NDArray) -> NDArray:
        """Outputs (k, n_outputs) of scaled inputs."""
        return self._layers(scaled)[-1]

    def _layers(self, scaled: NDArray) -> list[NDArray]:
        """Inputs, the values behind each hidden layer, and the outputs."""
        values = [scaled]
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = values[-1] @ weight + bias
            values.append(np.maximum(hidden, _LEAK * hidden))
        return [*values, values[-1] @ self.weights[-1] + self.biases[-1] + scaled @ self.skip]

    def _gradient(self, scaled: NDArray, targets: NDArray) -> list[NDArray]:
        """Gradient of the mean squared error with respect to weights, biases and skip."""
        *values, outputs = self._layers(scaled)
        error = (2 / len(scaled)) * (outputs - targets)
        of_skip, of_weights, of_biases = scaled.T @ error, [], []
        for weight, value in zip(self.weights[::-1], values[::-1], strict=True):
            of_weights.append(value.T @ error)
            of_biases.append(error.sum(axis=0))
            if value is not scaled:
                error = error @ weight.T * np.where(value > 0, np.float32(1), np.float32(_LEAK))
        return [*of_weights[::-1], *of_biases[::-1], of_skip]


def train(
    inputs: NDArray[np.float32], targets: NDArray[np.float32], hidden: tuple[int, ...], n_epochs: int,
    rng: np.random.Generator, report: Callable[[int], None],
) -> Network:  # fmt: skip
    """Fit a network to inputs (n, n_inputs) and targets (n, n_outputs) by Adam.

    The weights are rounded to half precision. `report` is called with the number of passes through the data that
    are done.
    """
    network = _random(inputs, targets, hidden, rng)
    values = [*network.weights, *network.biases, network.skip]
    means, squares = ([np.zeros_like(value) for value in values] for _ in range(2))
    n_steps, step = n_epochs * (len(inputs) // _BATCH), 0
    scaled = network.scaled(inputs)
    for epoch in range(n_epochs):
        order = rng.permutation(len(inputs))
        for first in range(0, len(inputs) - _BATCH + 1, _BATCH):
            batch, step = order[first : first + _BATCH], step + 1
            rate = _RATE * (1 + np.cos(np.pi * step / n_steps)) / 2
            rate *= np.sqrt(1 - _SQUARE**step) / (1 - _MEAN**step)
            gradient = network._gradient(scaled[batch], targets[batch])
            for value, slope, mean, square in zip(values, gradient, means, squares, strict=True):
                mean += (1 - _MEAN) * (slope - mean)
                square += (1 - _SQUARE) * (slope * slope - square)
                value -= np.float32(rate) * mean / (np.sqrt(square) + np.float32(1e-8))
        report(epoch + 1)
    for value in values:
        value[...] = value.astype(STORED)
    return network


def _random(inputs: NDArray, targets: NDArray, hidden: tuple[int, ...], rng: np.random.Generator) -> Network:
    """Network before its training: outputs near 0."""
    sizes = [inputs.shape[1], *hidden, targets.shape[1]]
    weights = [
        (rng.standard_normal((before, after)) * np.sqrt(2 / before)).astype(np.float32)
        for before, after in pairwise(sizes)
    ]
    weights[-1] *= np.float32(0.1)
    scale = (1 / np.maximum(inputs.std(axis=0), 1e-6)).astype(np.float32)
    biases = tuple(np.zeros(size, np.float32) for size in sizes[1:])
    skip = np.zeros((sizes[0], sizes[-1]), np.float32)
    return Network(inputs.mean(axis=0).astype(np.float32), scale, tuple(weights), biases, skip)
