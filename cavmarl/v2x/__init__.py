"""Messages between vehicles and roadside units: message schema, channel, and inboxes."""
