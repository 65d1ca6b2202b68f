"""One module for each notebook, with its name: experiment, figure, table, numbers and limits."""
