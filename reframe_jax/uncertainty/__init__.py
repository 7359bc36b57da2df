"""How sure an identification is, what the motion tested, and which motion would help most."""
