"""The environments of sumo-rl's API; importing this registers `sumo-rl-v0` with Gymnasium."""

import gymnasium

if "sumo-rl-v0" not in gymnasium.registry:
    gymnasium.register(
        id="sumo-rl-v0",
        entry_point="cavmarl.adapters.sumo_rl.environment.env:SumoEnvironment",
        kwargs={"single_agent": True},
    )
