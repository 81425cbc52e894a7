"""A person in the loop: one page in the browser to record, to see the styles and to steer."""
