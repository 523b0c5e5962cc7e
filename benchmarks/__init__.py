"""Measured figures, each beside the bound that it must keep.

``python -m benchmarks`` lists them, ``python -m benchmarks NAME...`` runs some. `registry` says how one is added.
"""
