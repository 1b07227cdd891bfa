"""The flows that come with caneflow; installed as `caneflow.flows`, written out by `caneflow new flow NAME`."""
