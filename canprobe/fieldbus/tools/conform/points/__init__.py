"""The points, one module a service; each point is a function with its number, clause and what is accepted."""
