"""Gradient steps towards fixed teaching signals: what is correct, and the ways to make them fast.

`eager_steps` defines what is correct; `product_steps` is for CPUs, with `winograd` or
`patch_convolutions` for the convolutions; `graphed_steps` is for GPUs. `compute` says which is
used.
"""
