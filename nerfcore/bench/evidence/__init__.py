"""The suite `evidence`: the tables of the method's publication measured anew, beside real baselines, by a protocol."""
