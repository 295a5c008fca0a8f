"""The source's experiments, each by one command that leaves a figure, a table and the numbers.

They use the in-process cores without a bus: a run of the same preset over the bus gives the same
weights on the same type of CPU.
"""
