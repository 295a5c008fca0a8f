"""The composition root: the command line, and everything that joins the other packages to a run.

`cli` has the commands, `topology` says which processes make up a run and `launch` keeps them alive;
`presets` are the experiments' numbers and `reproduce` makes the figures.
"""
