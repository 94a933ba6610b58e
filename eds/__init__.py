"""Device descriptions: a reader for EDS, DCF, XDD and XDC files of any vendor, and the packaged files.

The bytes of a file come in; an object dictionary of canopen and a list of findings go out. A finding is a warning where
the meaning is clear or the standard decides it; it prevents serving where it is unknown what the device is.
The stages, each in its module:

    sections      bytes → sections and keys, each with its line; one file while it is read, with its findings
    xml_sections  the same from an XDD or XDC file
    numbers       texts → numbers, sums with $NODEID, flags
    structure     sections → objects: the order of everything below; arrays and records, also in the compact form
    values        default, parameter value and limits by data type
    variables     one section → one variable; its data type as stated, as the editor defined it, or as is demanded
    object_lists  the lists of objects against the objects that the file describes
    device_info   [DeviceInfo], [Comments], [DeviceComissioning]
    mandatory     what the standards fix about objects that a node cannot do without
    findings      what is wrong in a file, and where
    reading       all of it: the whole file, mended where the standard allows
    description   what a dictionary states of its device, typed
    foreign_files what a file is that is no EDS file
    packaged      the files of this package, and `load_eds` for any file

Start reading at `packaged.load_eds`, then `reading`.
"""
