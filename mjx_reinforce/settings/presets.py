"""Published programs under names for the command line; ``presets.toml`` has their settings."""

from mjx_reinforce.settings.config import Config, read_tables

#: name -> (a line for --help, the settings).
PRESETS: dict[str, tuple[str, Config]] = {
    name: (table.pop("about"), Config(**table))
    for name, table in read_tables("presets.toml").items()
    if "about" in table
}
