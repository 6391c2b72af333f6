//! What sensors do that the specification does not say, each met by users of real ones.

use crate::codec::FieldSum;

/// How a sensor departs from the specification.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Quirks {
    /// The last line of `VV`, the serial number, has a wrong sum.
    pub wrong_sum: bool,
    /// What the sums of fields cover.
    pub field_sum: FieldSum,
    /// Lines end with CR LF.
    pub cr_lf: bool,
    /// `DMAX` is 100000.
    pub far: bool,
    /// `PP` says no more than measuring needs.
    pub terse: bool,
    /// What `VV` gets.
    pub identity: Identity,
    /// `TM` is an undefined command.
    pub knows_no_clock: bool,
}

/// What `VV` gets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Identity {
    /// Its answer.
    #[default]
    Told,
    /// "Undefined".
    Refused,
    /// Nothing.
    Silent,
}

type Field = (&'static str, &'static str);

pub(super) const MODEL: Field = ("MODL", "URG-04LX(Hokuyo Automatic Co.,Ltd.)");

/// `VV`.
pub(super) const IDENTITY: [Field; 5] = [
    ("VEND", "Hokuyo Automatic Co.,Ltd."),
    ("PROD", "SOKUIKI Sensor URG-04LX"),
    ("FIRM", "3.1.04(02/Aug./2007)"),
    ("PROT", "SCIP 2.0"),
    ("SERI", "H0000000"),
];

impl Quirks {
    /// None.
    pub const NONE: Self = Self {
        wrong_sum: false,
        field_sum: FieldSum::Value,
        cr_lf: false,
        far: false,
        terse: false,
        identity: Identity::Told,
        knows_no_clock: false,
    };

    /// Each alone, with a name.
    pub const EACH: [(&'static str, Self); 9] = [
        ("wrong-sum", Self { wrong_sum: true, ..Self::NONE }),
        ("semicolon-sum", Self { field_sum: FieldSum::Semicolon, ..Self::NONE }),
        ("short-sum", Self { field_sum: FieldSum::Short, ..Self::NONE }),
        ("cr-lf", Self { cr_lf: true, ..Self::NONE }),
        ("far", Self { far: true, ..Self::NONE }),
        ("terse", Self { terse: true, ..Self::NONE }),
        ("vv-refused", Self { identity: Identity::Refused, ..Self::NONE }),
        ("vv-silent", Self { identity: Identity::Silent, ..Self::NONE }),
        ("no-clock", Self { knows_no_clock: true, ..Self::NONE }),
    ];

    /// `PP`.
    pub(super) fn geometry(&self) -> [Field; 8] {
        [
            MODEL,
            ("DMIN", "20"),
            ("DMAX", if self.far { "100000" } else { "5600" }),
            ("ARES", "1024"),
            ("AMIN", "44"),
            ("AMAX", "725"),
            ("AFRT", "384"),
            ("SCAN", "600"),
        ]
    }

    /// So many of them are not said.
    pub(super) fn geometry_skipped(&self) -> usize {
        if self.terse { 3 } else { 0 }
    }
}
