"""Car-following models: the acceleration of a driver behind leaders and before lines.

Read `following` first. In a tick, `drivers.decide` calls `behind` and `before_line` for each
obstacle, `wish` for the decision on a lane change, and `response` once at the end. Each function
calls the function of the same name of the vehicle type's model: `idm`, `krauss`, `acc`, or a model
that a user registers (`registered_models`). `car_following_model` describes the functions of a
model; CONTRIBUTING.md says how to add one.
"""
