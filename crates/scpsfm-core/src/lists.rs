//! Macros that write down in one list what would stand in several.

/// A struct of values, each with what it means, its default and the reason for that: `DEFAULT` has all of these.
macro_rules! options {
    (
        $(#[$about:meta])*
        $visibility:vis struct $name:ident {
            $($(#[$meaning:meta])* $field:ident: $type:ty = $value:expr,)*
        }
    ) => {
        $(#[$about])*
        #[derive(Debug, Clone, PartialEq)]
        $visibility struct $name {
            $($(#[$meaning])* pub $field: $type,)*
        }

        impl $name {
            pub const DEFAULT: Self = Self { $($field: $value,)* };
        }
    };
}

/// An enumeration, all of its values and the name of each, on the command line, in files and to callers, from one list.
#[macro_export]
macro_rules! named {
    (
        $(#[$about:meta])*
        pub enum $kind:ident {
            $($(#[$meaning:meta])* $value:ident = $name:literal,)*
        }
    ) => {
        $(#[$about])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
        pub enum $kind {
            $($(#[$meaning])* #[serde(rename = $name)] $value,)*
        }

        impl $kind {
            /// Every value, in the order of the list.
            pub const ALL: [Self; [$($name),*].len()] = [$(Self::$value),*];

            /// The value's name.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$value => $name,)*
                }
            }

            /// The value of that name.
            pub fn from_name(name: &str) -> Option<Self> {
                Self::ALL.into_iter().find(|value| value.name() == name)
            }
        }
    };
}
