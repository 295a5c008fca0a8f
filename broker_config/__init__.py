"""The bus contract: what may be said, under which key, how it is delivered and kept.

Every other package imports this one and it imports none of them. It is the only package that speaks
Zenoh, and it needs neither a learning nor a simulation library, so that a robot's computer can
attach with little more than this folder.
"""
