"""Protected functions of users: where they come from, how they are loaded, and what they are asked."""
