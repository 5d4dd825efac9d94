"""Gradient descent on the PHSI loss, the thesis' own method, on the same measurements.

It is imported from its file, ``from phsi_opt.baselines.gradient_descent import
gradient_descent``: it needs the extra ``baselines``, the package itself does not.
"""
