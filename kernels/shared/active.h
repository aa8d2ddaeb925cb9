// Items of worlds that do not rest.
#pragma once

namespace warpmag {

// Item ``n`` of a list, or −1 beyond its end. The list holds the number of its items, then these. Without a list the
// items are 0, 1, 2, ...
template <class List> CUDA_CALLABLE inline int active_item(const List& list, int n) {
    if (!list.data) return n;
    return n < list.data[0] ? list.data[n + 1] : -1;
}
}
