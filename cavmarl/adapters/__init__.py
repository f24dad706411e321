"""Views of a world for libraries that do not read PettingZoo: Gymnasium, SB3, TorchRL, RLlib.

They stand on `env` and know nothing of how worlds are run.
"""
