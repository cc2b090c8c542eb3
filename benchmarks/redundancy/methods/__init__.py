"""The methods: every file here has a tuple METHODS."""
