"""Where the cane is: the paper's observer, the filters, and what they are compared with."""
