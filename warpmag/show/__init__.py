"""Pictures, pages and exports of finished stages. Nothing but the command imports this room."""
