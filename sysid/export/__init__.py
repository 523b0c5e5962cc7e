"""An identified structure in the files of other programs, one module a format; `sysid.export` chooses by the ending."""
