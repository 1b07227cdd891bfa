"""A recording run again: held against the outputs that it holds, or against the truth."""
