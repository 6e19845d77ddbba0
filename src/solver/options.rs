//! How thresholds are written down.

/// A struct of thresholds, each with what it means, its value and the reason for that: `DEFAULT` has these values.
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
