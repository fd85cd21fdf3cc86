"""The viewer: a page for browsers, made of the sources in web/, and a server of it and of a scene."""
