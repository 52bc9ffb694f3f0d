#!/bin/sh
# The protected function of docs/functions.md without JSON or any library: a request has no blanks, and a fixed order.
# Reply and state are the sum in four bytes, the least first.
little_endian() {
    printf '%02x%02x%02x%02x' $(($1 & 255)) $(($1 >> 8 & 255)) $(($1 >> 16 & 255)) $(($1 >> 24 & 255))
}
sum=0
while read -r line; do
    number=${line#*:} number=${number%%,*}
    given=${line##*:} given=${given#\"} given=${given%\"\}}
    case $line in
    *'"describe"'*)
        answer='"describe":{"deterministic":true,"state_access":"exact"}'
        ;;
    *'"execute"'*)
        case $given in
        ??)
            sum=$((sum + 0x$given & 0xffffffff))
            answer="\"execute\":\"$(little_endian $sum)\""
            ;;
        *) answer='"error":"a request has one byte"' ;;
        esac
        ;;
    *'"capture"'*)
        answer="\"capture\":\"$(little_endian $sum)\""
        ;;
    *'"restore"'*)
        case $given in
        ????????)
            a=${given%??????} d=${given#??????} given=${given#??} given=${given%??}
            sum=$((0x$d << 24 | 0x${given#??} << 16 | 0x${given%??} << 8 | 0x$a))
            answer='"restore":null'
            ;;
        *) answer='"error":"a state has four bytes"' ;;
        esac
        ;;
    esac
    echo "{\"id\":$number,$answer}"
done
