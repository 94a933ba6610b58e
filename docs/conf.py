"""Settings of the documentation: `sphinx-build -W docs site` writes it, and `site/index.html` opens from disk."""

project = "canprobe"
copyright = "the canprobe authors, MIT licence"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton", "sphinx_external_toc"]
external_toc_path = "_toc.yml"
exclude_patterns = ["*.py", "example", "**/.ipynb_checkpoints"]
html_theme = "furo"
html_title = "canprobe"
html_css_files = ["style.css"]
html_static_path = ["style.css"]
html_show_sphinx = False
html_copy_source = False

nb_execution_mode = "off"  # they are stored with what they show
myst_heading_anchors = 4
myst_links_external_new_tab = False

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
autodoc_preserve_defaults = True
default_role = "code"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
napoleon_use_rtype = False
napoleon_use_param = False
napoleon_use_ivar = True
add_module_names = True
