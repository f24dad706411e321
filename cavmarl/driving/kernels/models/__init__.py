"""Car-following models: how hard a driver accelerates or brakes.

Open `following` first. It turns a leader or a line into a constraint (`behind`, `before_line`),
and the binding constraint into an acceleration (`response`), by the model of the vehicle's type:
`idm`, `krauss`, `acc`, or a model from outside of the package (`registered_models`). In a tick
`drivers.decide` calls `behind` and `before_line` for each obstacle, `wish` when it weighs a lane
change, and `response` once at the end. A further model is one file here and one branch in each
function of `following`; its code and its name are in `driving/driver_models.py`.
"""
