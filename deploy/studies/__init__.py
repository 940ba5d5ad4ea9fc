"""Studies of what the verbs do: nothing outside this package and its commands imports it."""
