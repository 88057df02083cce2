"""A recorded flight as one page for people: summary, plots, events. quantities -> decimate, analysis -> page, plots_png."""
