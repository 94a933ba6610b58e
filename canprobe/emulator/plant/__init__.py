"""The emulated cell behind the nodes: arm, contact, tactile array. Pure: time goes in as a number."""
