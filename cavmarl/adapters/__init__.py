"""Views of worlds for libraries other than PettingZoo: Gymnasium, SB3, TorchRL, RLlib.

Builds on `env`, independent of how worlds are run.
"""
