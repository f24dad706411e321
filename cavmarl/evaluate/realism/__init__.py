"""Realism of rollouts of a logged scene: the meta-metric of the Waymo Open Sim Agents Challenge."""
