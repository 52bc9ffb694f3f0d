"""Protected functions of users: how a text names one, and how it is loaded (`load.load_application`)."""
