"""How good labels are: flow, static removal and boxes against annotations, and one report of them."""
