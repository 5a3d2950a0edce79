"""The terms of the energy, one a file: value and gradient together, in one pass over a band of rows.

Each ``*_band`` kernel *adds* its rows of the per-pixel map and of the gradient, so that terms compose without
temporaries; :mod:`variational.energy` calls them. docs/adding_a_term.md shows how to write another.
"""
