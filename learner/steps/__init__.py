"""Gradient steps towards fixed teaching signals: what is correct, and the ways to make them fast.

`eager_steps` defines what is correct; `product_steps` is for CPUs, with `winograd` for the
convolutions and `rounded_adam` for weights that are rounded; `graphed_steps` is for GPUs. `compute`
says which is used.
"""
