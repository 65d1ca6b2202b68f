"""Set-ups, styles, parameters, results and sweeps that the studies share."""
