"""Local shape from contacts: the model, what is assumed, batch fits, online estimators, their answers and bound."""
