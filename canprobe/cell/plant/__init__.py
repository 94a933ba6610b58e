"""The emulated cell behind the nodes: arm, contact, tactile array. Pure: time goes in as a number.

`plant.Plant` is asked for motor positions, torques and images at an instant, and moves itself there.

- Both arms have 1 to 8 joints that turn or slide. `ideal_arm`: each drive is a second-order system, solved exactly.
  `dynamic_arm`: rigid links, friction, drive cascade and the object's push, by `equations` and one of the
  `integrators` on dynamics held over a cycle; `pushing` is the contact forces near one posture.
- `contact` finds the contact of a state: where the probe's ball is, what it touches and what presses. `elastic_contact`
  has the laws of its elastic layer (Winkler, Hunt–Crossley damping), in one place and in several.
- `pressure` averages the contact over each taxel; `taxels` makes counts of it: blur, gains, saturation, hysteresis,
  creep, crosstalk, noise, quantisation.
- `config` is the configuration of a plant.

The image model shares no formula with the estimators. Energy is not created in a closed contact cycle without
friction.
"""
