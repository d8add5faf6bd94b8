"""HTML, CSS, and JavaScript of the page, and the messages that the page sends back."""
