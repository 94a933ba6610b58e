"""Scene → plan: which nodes and PDOs a scene needs, whether they fit, what is left out and why.

`make.make_plan` asks the others: `devices` what the EDS files allow, `traffic` what fits the bus, `motion` what the arm
can do, `choices` what the scene has left open. The answer is a `model.Plan`; `report` writes it for people and tools.
"""
