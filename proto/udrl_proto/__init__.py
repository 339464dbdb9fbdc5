"""The wire contract: messages, key expressions, and how to ask and answer over Zenoh.

``proto/README.md`` is the page from which someone could write an actor in another language.
"""

PROTOCOL = 2
