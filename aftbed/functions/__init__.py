"""Protected functions of users: how a text names one, how it is loaded (`load.load_application`), and the
requests that it is sent (`request_file`)."""
