"""Test vectors for models of the Zernike wavefront sensor: cases, the files that hold them, and other packages."""
