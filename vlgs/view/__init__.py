"""A trained scene in a browser: `python -m vlgs.view RUN`.

Pictures come from the fields themselves and are sent as JPEG. `vlgs.view.server` is the only module that knows the web server (viser); what is drawn,
and when, is decided by the others.
"""
