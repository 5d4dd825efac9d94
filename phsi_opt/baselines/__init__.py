"""Other methods on the same measurements: gradient descent, SSINN, PHNN and SINDy.

Each lives in a file of its own and is imported from there, such as ``from
phsi_opt.baselines.gradient_descent import gradient_descent``: they need the extra
``baselines``, the package itself does not.
"""
