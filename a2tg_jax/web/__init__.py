"""The viewer: a page for browsers, built from the sources in web/, and a server for it."""
