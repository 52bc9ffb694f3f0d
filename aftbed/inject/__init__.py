"""Everything about faults: their words, their targets, what they do, and the proof that they did it.

`model.py` has the fault and the registry of its kinds, `kind.py` the interface of a kind; `crash`, `hang`,
`slow`, `channel`, `value`, `state`, `memory` and `bus` are the kinds. `agent.py` is the half of the
injector that sits in a node; the other half, `runtime/fault_controller.py`, sits in the supervisor.
"""
