"""Messages between vehicles and roadside units: their schema, the channel, and inboxes."""
