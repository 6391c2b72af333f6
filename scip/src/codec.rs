//! The protocol's encoding: six bits a character, and the sum that ends a line.
//!
//! Nothing here knows of commands or replies; see [`decoder`](crate::decoder) for what reads lines.

/// What is added to six bits to make a character: `0`.
const OFFSET: u8 = 0x30;
/// Data lines hold so many characters before their sum.
pub const DATA_CHARS: usize = 64;

/// Six bits of a character, `None` where it is outside the alphabet `0` … `o`.
#[inline]
pub const fn six_bits(character: u8) -> Option<u8> {
    let bits = character.wrapping_sub(OFFSET);
    if bits < 64 { Some(bits) } else { None }
}

/// The value of up to five characters, most significant first. `None` if one is outside the alphabet, or there are more
/// than five.
pub fn decode(characters: &[u8]) -> Option<u32> {
    if characters.len() > 5 {
        return None;
    }
    characters.iter().try_fold(0, |value, &c| Some(value << 6 | u32::from(six_bits(c)?)))
}

/// The lowest `6 · N` bits of a value as `N` characters, most significant first.
pub fn encode<const N: usize>(value: u32) -> [u8; N] {
    core::array::from_fn(|i| {
        let shift = 6 * (N - 1 - i) as u32;
        value.checked_shr(shift).unwrap_or(0) as u8 % 64 + OFFSET
    })
}

/// The character that ends a line: the lowest six bits of the bytes' sum.
///
/// A change of bit 6 or 7 of a byte leaves it as it is. In data lines such a change leaves the alphabet instead, which is
/// why [`six_bits`] must be checked as well.
pub fn sum(bytes: &[u8]) -> u8 {
    close_sum(bytes.iter().fold(0, |sum, &b| sum.wrapping_add(b)))
}

/// The character for bytes already added up, modulo 256.
pub const fn close_sum(added: u8) -> u8 {
    added % 64 + OFFSET
}

/// What the sum of a `KEY:value;S` line covers. Sensors differ, and the vendor's library accepts the first two.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FieldSum {
    /// `KEY:value`, as the specification says.
    #[default]
    Value,
    /// The `;` too.
    Semicolon,
    /// `KEY:value` but for its last character.
    Short,
}

impl FieldSum {
    /// All there are.
    pub const ALL: [Self; 3] = [Self::Value, Self::Semicolon, Self::Short];

    /// The sum of a line, of which `body` is `KEY:value`.
    pub fn of(self, body: &[u8]) -> u8 {
        match self {
            Self::Value => sum(body),
            Self::Semicolon => close_sum(body.iter().fold(b';', |sum, &b| sum.wrapping_add(b))),
            Self::Short => sum(body.split_last().map_or(body, |(_, rest)| rest)),
        }
    }

    pub(crate) const fn bit(self) -> u8 {
        1 << self as u8
    }
}

/// Takes the sum off a line that ends in one; `None` where it does not fit.
pub fn without_sum(line: &[u8]) -> Option<&[u8]> {
    let (&last, body) = line.split_last()?;
    (sum(body) == last).then_some(body)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_specification_s_numbers() {
        assert_eq!(&encode::<2>(1234), b"CB");
        assert_eq!(&encode::<3>(5432), b"1Dh");
        assert_eq!(&encode::<4>(16_000_000), b"m2@0");
        assert_eq!(decode(b"CB"), Some(1234));
        assert_eq!(decode(b"1Dh"), Some(5432));
        assert_eq!(decode(b"m2@0"), Some(16_000_000));
        assert_eq!(decode(b"JUGn"), Some(6_968_830));
    }

    #[test]
    fn the_specification_s_sums() {
        for line in
            ["00P", "99b", "01Q", "02R", "03S", "04T", "10Q", "98a", "0Aa", "0Bb", "0Cc", "0Dd", "0Ee", "0Ii"]
        {
            assert!(without_sum(line.as_bytes()).is_some(), "{line}");
        }
        assert_eq!(without_sum(b"00Q"), None);
        assert_eq!(without_sum(b""), None);
    }

    #[test]
    fn sums_of_fields_cover_what_sensors_make_them_cover() {
        // Of the specification: ARES:1024;\ and AMAX:725;o.
        assert_eq!([FieldSum::Value.of(b"ARES:1024"), FieldSum::Value.of(b"AMAX:725")], [b'\\', b'o']);
        for (body, wide) in [(&b"ARES:1024"[..], &b"ARES:1024;"[..]), (b"SERI:H0706400", b"SERI:H0706400;")] {
            assert_eq!(FieldSum::Semicolon.of(body), sum(wide));
            assert_eq!(FieldSum::Short.of(body), sum(&body[..body.len() - 1]));
        }
    }

    #[test]
    fn the_alphabet_ends_at_o() {
        assert_eq!(six_bits(b'0'), Some(0));
        assert_eq!(six_bits(b'o'), Some(63));
        assert_eq!(six_bits(b'p'), None);
        assert_eq!(six_bits(b'/'), None);
        assert_eq!(six_bits(b'0' | 0x80), None);
        assert_eq!(decode(b"0p"), None);
        assert_eq!(decode(b"000000"), None);
    }
}
