"""Tables and glued numbers of the notebooks: one module for each notebook, with the same stem."""
