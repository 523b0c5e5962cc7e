"""The report page, by the browser's own measure."""
