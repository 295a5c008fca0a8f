"""Actors: tasks and cloth, the policies that act in them, and the process that does so on the bus.

`envs` holds the tasks and `cloth` what they are made of; `networks`, `policy` and `acting` choose
actions; `rollout` plays an episode and knows no bus; `service` and `delivery` put it on the bus.
"""
