//! Encoding of fixed-size records as little-endian `u32` words, for ops and the tables of an image.
//!
//! A record is a struct whose fields are written one after the other, each in a fixed number of
//! words. Writing cannot fail (the sizes are compared at compile time); reading fails with `None`
//! on an unknown discriminant, so a record that was read is written again bit for bit.

use core::slice;

/// Writer over the words of one record that are not yet written.
pub struct Writer<'b>(slice::IterMut<'b, u32>);

impl<'b> Writer<'b> {
    /// Writes into `words` from the first word on.
    pub fn new(words: &'b mut [u32]) -> Self {
        Self(words.iter_mut())
    }

    /// Writes one word. Words beyond the record are dropped; [`Field::WORDS`] keeps that from happening.
    pub fn word(&mut self, value: u32) {
        if let Some(word) = self.0.next() {
            *word = value;
        }
    }
}

/// Reader over the words of one record that are not yet read.
pub struct Reader<'b>(slice::Iter<'b, u32>);

impl<'b> Reader<'b> {
    /// Reads `words` from the first word on.
    pub fn new(words: &'b [u32]) -> Self {
        Self(words.iter())
    }

    /// Returns the next word, or `None` at the end.
    pub fn word(&mut self) -> Option<u32> {
        self.0.next().copied()
    }

    /// Returns true if every remaining word is zero, as records leave their unused words.
    pub fn rest_is_zero(self) -> bool {
        self.0.into_iter().all(|&word| word == 0)
    }
}

/// A value with a fixed number of words.
pub trait Field: Copy {
    /// Number of words that the value takes.
    const WORDS: usize;

    /// Appends the value.
    fn put(&self, out: &mut Writer);

    /// Reads the value; `None` if the words are not a valid encoding.
    fn take(from: &mut Reader) -> Option<Self>;
}

impl Field for u32 {
    const WORDS: usize = 1;
    fn put(&self, out: &mut Writer) {
        out.word(*self);
    }
    #[inline]
    fn take(from: &mut Reader) -> Option<Self> {
        from.word()
    }
}

impl Field for i32 {
    const WORDS: usize = 1;
    fn put(&self, out: &mut Writer) {
        out.word(self.cast_unsigned());
    }
    #[inline]
    fn take(from: &mut Reader) -> Option<Self> {
        from.word().map(u32::cast_signed)
    }
}

impl Field for f32 {
    const WORDS: usize = 1;
    fn put(&self, out: &mut Writer) {
        out.word(self.to_bits());
    }
    #[inline]
    fn take(from: &mut Reader) -> Option<Self> {
        from.word().map(f32::from_bits)
    }
}

impl Field for u64 {
    const WORDS: usize = 2;
    fn put(&self, out: &mut Writer) {
        out.word(*self as u32);
        out.word((*self >> 32) as u32);
    }
    #[inline]
    fn take(from: &mut Reader) -> Option<Self> {
        let low = u64::from(from.word()?);
        Some(low | u64::from(from.word()?) << 32)
    }
}

impl Field for bool {
    const WORDS: usize = 1;
    fn put(&self, out: &mut Writer) {
        out.word(u32::from(*self));
    }
    #[inline]
    fn take(from: &mut Reader) -> Option<Self> {
        match from.word()? {
            0 => Some(false),
            1 => Some(true),
            _ => None,
        }
    }
}

/// Encoded as a flag word, then the value; all zero for `None`.
impl<T: Field> Field for Option<T> {
    const WORDS: usize = 1 + T::WORDS;
    fn put(&self, out: &mut Writer) {
        self.is_some().put(out);
        if let Some(value) = self {
            value.put(out);
        } else {
            for _ in 0..T::WORDS {
                out.word(0);
            }
        }
    }
    #[inline]
    fn take(from: &mut Reader) -> Option<Self> {
        if bool::take(from)? {
            return T::take(from).map(Some);
        }
        for _ in 0..T::WORDS {
            if from.word()? != 0 {
                return None;
            }
        }
        Some(None)
    }
}

impl<T: Field + Default, const N: usize> Field for [T; N] {
    const WORDS: usize = N * T::WORDS;
    fn put(&self, out: &mut Writer) {
        for value in self {
            value.put(out);
        }
    }
    #[inline]
    fn take(from: &mut Reader) -> Option<Self> {
        let mut values = [T::default(); N];
        for value in &mut values {
            *value = T::take(from)?;
        }
        Some(values)
    }
}

/// Declares a struct of [`Field`]s and makes it a [`Field`]: its words are its fields' words in the order of declaration.
macro_rules! record {
    ($(#[$meta:meta])* pub struct $name:ident { $($(#[$field_meta:meta])* pub $field:ident: $type:ty,)* }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq)]
        pub struct $name { $($(#[$field_meta])* pub $field: $type,)* }

        impl $crate::codec::Field for $name {
            const WORDS: usize = 0 $(+ <$type as $crate::codec::Field>::WORDS)*;
            fn put(&self, out: &mut $crate::codec::Writer) {
                $($crate::codec::Field::put(&self.$field, out);)*
            }
            #[inline(always)]
            fn take(from: &mut $crate::codec::Reader) -> Option<Self> {
                Some(Self { $($field: $crate::codec::Field::take(from)?,)* })
            }
        }
    };
}

/// Declares an enum of one word, its discriminants written out, and makes it a [`Field`].
macro_rules! word_enum {
    ($(#[$meta:meta])* pub enum $name:ident { $($(#[$variant_meta:meta])* $variant:ident = $value:literal,)* }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[repr(u32)]
        pub enum $name { $($(#[$variant_meta])* $variant = $value,)* }

        impl $name {
            /// All values, in the order of the discriminants.
            pub const ALL: &'static [Self] = &[$(Self::$variant,)*];
        }

        $crate::codec::word_enum_for! { $name { $($variant = $value,)* } }
    };
}

/// Makes an enum of another crate a [`Field`] of one word with the discriminants written here.
macro_rules! word_enum_for {
    ($name:ty { $($variant:ident = $value:literal,)* }) => {
        impl $crate::codec::Field for $name {
            const WORDS: usize = 1;
            fn put(&self, out: &mut $crate::codec::Writer) {
                out.word(match self { $(Self::$variant => $value,)* });
            }
            #[inline(always)]
            fn take(from: &mut $crate::codec::Reader) -> Option<Self> {
                match from.word()? {
                    $($value => Some(Self::$variant),)*
                    _ => None,
                }
            }
        }
    };
}

pub(crate) use {record, word_enum, word_enum_for};
