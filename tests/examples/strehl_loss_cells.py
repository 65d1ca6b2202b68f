# The cells of a notebook: `# %%` begins a cell, `tags` are its tags.
# %% [markdown]
# # How fast does the Strehl ratio fall?
#
# The Strehl ratio is the peak intensity of a star over that without aberrations.
# %% tags=["parameters"]
n_pixels = 64  # samples across the pupil diameter D
inputs = [0.1, 0.5, 1.0]  # wavefront errors, rad rms
n_screens = 5  # random screens for each input
seed = 2024  # of all random screens
# %% tags=["remove-cell"]
from studies import strehl_loss as study
from studies.kit.parameters import check_parameters

check_parameters(globals(), **study.LIMITS)
# %% tags=["hide-input"]
import zwfs
from studies.kit.results import publish
from studies.kit.style import use_style

use_style()
# %%
pupil = zwfs.Pupil.circular(n_pixels)
modes = zwfs.zernike_basis(pupil, 50)
ratio = study.mean_strehl(pupil, modes, inputs, n_screens, seed)
# %% tags=["hide-input"]
study.findings(inputs, ratio)
# %% tags=["hide-input"]
figure = study.draw_strehl(inputs, ratio)
publish(figure, "strehl_loss", study.strehl_columns(inputs, ratio))
