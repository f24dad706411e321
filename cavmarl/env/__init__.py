"""What a policy sees: PettingZoo's view, the vector environment, actions, and registration.

Stands on `parallel`; `policies`, `adapters` and `evaluate` use it.
"""
