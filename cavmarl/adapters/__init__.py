"""Views of worlds for libraries other than PettingZoo: Gymnasium, SB3, TorchRL, RLlib.

They build on `env` and do not depend on how worlds are run.
"""
