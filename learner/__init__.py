"""The learner: improves the policy from what actors did, and owns the journal of the run.

`teaching_signal`, `memory`, `trainer` and `steps` are the algorithm and know no bus; `tickets` and
`owner` decide what is collected and what counts; `learning` is the loop that joins them; `service`
puts it all on the bus.
"""
