"""``covrecon pki``: the authority of a fleet, and the certificates that it issues.

`signing` makes keys and certificates in memory, `files` puts them on disk, `authority` keeps the folder and its
register, `inventory` says how they fare.
"""
