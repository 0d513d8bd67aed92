"""How good is each demonstration of a dataset, from 0 to 1, whoever recorded it: reasons in words and frames."""
