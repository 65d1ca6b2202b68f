"""The test vectors: three independent methods agree on them, and packages as the book states."""

import csv
import re

import numpy as np
import pytest
from astropy.io import fits

from studies.identities import direct_reference_wave

from .conftest import ROOT, code_of
from .vectors import make, packages

CASES = {case.name: case for case in make.cases()}
AGREEMENT = {row.pop("case"): row for row in csv.DictReader(packages.AGREEMENT.open(encoding="utf-8"))}


@pytest.fixture(params=CASES, scope="module")
def case(request):
    return CASES[request.param]


def npz(case):
    with np.load(make.FOLDER / f"{case.name}.npz") as file:
        return dict(file)


def test_files_are_those_of_the_cases_and_small():
    files = [*make.FOLDER.glob("*.npz"), *make.FOLDER.glob("*.fits")]
    named = {f"{name}.{end}" for name in CASES for end in ("npz", "fits")}
    assert {file.name for file in files} == named
    assert sum(file.stat().st_size for file in files) < 3e6


def test_npz_is_what_the_script_makes(case):
    stored = npz(case)
    for name, values in case.arrays().items():
        if name in ("frames", "field"):
            np.testing.assert_allclose(stored[name], values, rtol=0, atol=1e-13)
        elif name == "amplitude":
            np.testing.assert_allclose(stored[name], values, rtol=1e-15)
        else:
            np.testing.assert_array_equal(stored[name], values)


def test_fits_holds_the_same(case):
    stored = npz(case)
    with fits.open(make.FOLDER / f"{case.name}.fits") as file:
        file.verify("exception")
        header = file[0].header
        np.testing.assert_array_equal(file[0].data, stored["frames"])
        np.testing.assert_array_equal(file["PHASE"].data, stored["phase"])
        np.testing.assert_array_equal(file["AMPLITUDE"].data, stored["amplitude"])
        np.testing.assert_array_equal(file["FIELD_RE"].data + 1j * file["FIELD_IM"].data, stored["field"])
    assert header["NPIXELS"] == stored["n_pixels"]
    for k, mask in enumerate(stored["masks"], start=1):
        assert tuple(header[f"{name}{k}"] for name in ("DIAM", "PHASE", "AMPL", "TILT")) == tuple(mask)


@pytest.mark.parametrize(("tolerance", "bound"), [(1e-10, 1e-10), (1e-14, 3e-14)])
def test_zwfs_agrees(case, tolerance, bound):
    assert np.abs(packages.by_zwfs(case, tolerance) - npz(case)["frames"]).max() < bound


@pytest.mark.parametrize("name", ["circular_wedge", "odd_pair_large", "segmented_pair_large", "oblong_pair"])
def test_a_sum_over_the_focal_plane_agrees(name):
    case = CASES[name]
    field = case.pupil.field(case.phase)
    waves = [direct_reference_wave(case.pupil, packages.own_mask(mask), field) for mask in case.masks]
    np.testing.assert_allclose(field + np.stack(waves), npz(case)["field"], rtol=0, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("package", packages.PACKAGES)
def test_packages_agree_as_the_book_states(case, package):
    stated, error = AGREEMENT[case.name][package], packages.error(package, case)
    if error is None:
        assert stated == packages.UNABLE
    elif package.startswith("zwfs"):
        assert error < 10 * float(stated)  # close to rounding, other processors differ
    else:
        assert error == pytest.approx(float(stated), rel=0.06)


@pytest.mark.parametrize("code", code_of("vectors.md"))
def test_code_of_the_page_prints_what_the_page_says(code, capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    exec(compile(code, "book/vectors.md", "exec"), {})
    stated = re.findall(r"(?m)^print\(.*#  *(.+)$", code)
    printed = capsys.readouterr().out.splitlines()
    assert stated
    assert [" ".join(line.split()) for line in printed] == stated
