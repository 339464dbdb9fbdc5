"""The wire contract: messages, key expressions, and requests and replies over Zenoh.

``proto/README.md`` specifies it for implementations in other languages.
"""

PROTOCOL = 5
